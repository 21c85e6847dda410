"""Pages, films and pictures of what was made."""
