"""Files and messages: bags, tables, maps, results."""
