"""Send one call to a provider, and read its bytes."""
