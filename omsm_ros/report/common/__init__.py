"""What all pages share: style, words for quantities, response figures."""
