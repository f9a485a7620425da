"""Support several hosts: runs on Ray, object stores, shared history and logs."""
