"""The device's side of each protocol, fed by the twin, with a list of faults it can play."""
