"""Record paid calls.

Answers, votes and money lie in one SQL database per study.
"""
