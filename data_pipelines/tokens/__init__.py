"""The token store: what is in it, how it is made by one process or many, how it is read."""
