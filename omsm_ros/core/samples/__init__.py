"""What devices deliver: blocks, counters, recordings, and where every sample went."""
