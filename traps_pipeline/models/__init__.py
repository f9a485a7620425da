"""Ask models and judges.

The registry, requests and outcomes, the backends, and how calls are sent and recorded.
"""
