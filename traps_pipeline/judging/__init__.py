"""Judge answers.

The panel's judges are asked here, and their votes become verdicts (docs/spec.md 4).
"""
