"""The benchmark as data: released records, corrections folded over them, versions, items."""
