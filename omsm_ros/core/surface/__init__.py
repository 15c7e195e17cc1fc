"""From points to a result: nominal shapes and the deviation from them."""
