"""Wire formats, bytes to values and back: no input or output, safe on any split of a stream."""
