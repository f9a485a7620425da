"""Ask models and judges: registry, requests, backends, and how calls are recorded."""
