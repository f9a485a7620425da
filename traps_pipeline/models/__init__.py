"""Who answers: the registry of models, what is asked of them (Request), what comes back (Outcome), who asks (backends)."""
