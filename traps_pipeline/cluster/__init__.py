"""Support several hosts.

Runs on Ray, a study in an object store, shared history and logs.
"""
