"""Ask models and judges for the calls that the ledger lacks."""
