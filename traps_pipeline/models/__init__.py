"""Models and judges: the registry, requests and outcomes, the backends, and how calls are sent and recorded."""
