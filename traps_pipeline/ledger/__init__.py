"""What was paid for: answers, votes and money, in one SQL database of a study."""
