"""Speed and accuracy, each against a peer, a bound or the truth, in one run."""
