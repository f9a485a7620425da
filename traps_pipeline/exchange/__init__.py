"""Exchange calls with other systems: export requests, batches and media, and import answers and votes."""
