"""Who answers: the registry of models, what is asked (Request), what comes back (Outcome), who asks (backends)."""
