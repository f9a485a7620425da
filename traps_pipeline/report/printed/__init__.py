"""The paper's tables as the paper prints them: its rows, columns, digits and notes (`assets/published`)."""
