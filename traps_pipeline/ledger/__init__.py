"""Record paid calls: answers, votes and money in one SQL database per study."""
