"""Pages that set the paper's experiments beside ours."""
