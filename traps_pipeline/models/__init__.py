"""Ask models and judges: from below, a call, its text, the registry, money, the wire, and asking."""
