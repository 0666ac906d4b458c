"""Pages, pictures and tables, made from what the other stages left on disk."""
