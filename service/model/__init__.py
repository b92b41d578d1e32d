"""What everything may import: the words of graspd as types, errors, names, digests, records, pure rules."""
