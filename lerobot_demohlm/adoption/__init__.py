"""A trained controller -> the default one, once it has passed every check that the present one has."""
