"""People: samples to label, their labels, the human row, scores corrected by them, judges validated against them."""
