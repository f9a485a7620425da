"""Support for several hosts: runs on Ray, a study in an object store, shared history and logs."""
