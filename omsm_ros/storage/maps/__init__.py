"""Maps and clouds of surfaces in the formats of other programs and instruments."""
