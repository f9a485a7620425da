"""Exchange calls with other systems.

Requests, batches and media are exported, answers and votes imported.
"""
