"""Run transformers checkpoints on this machine, behind the same ledger as any API.

`library` loads torch and transformers, `checkpoint` finds and identifies weights, `adapter` makes one object of any
image-text-to-text model, `backend` answers requests with it in batches, `tiny` builds random checkpoints of each
family. Nothing here is imported at start: torch takes seconds.
"""
