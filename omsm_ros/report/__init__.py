"""A measurement for people: figures and one self-contained HTML page."""
