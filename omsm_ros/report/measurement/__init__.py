"""The page of a measurement: maps, profiles, and its verdict."""
