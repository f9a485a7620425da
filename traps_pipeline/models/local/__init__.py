"""Local models: checkpoints of transformers, asked on this machine through the same ledger path as any API.

`library` loads torch and transformers, `checkpoint` finds weights and says what they are, `adapter` makes one object of
any image-text-to-text model, `backend` answers requests with it in batches, `tiny` builds random checkpoints of each
family. Nothing here is imported at start: torch takes seconds.
"""
