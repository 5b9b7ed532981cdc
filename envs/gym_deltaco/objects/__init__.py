"""The objects: solids made from code, and sets of them."""
