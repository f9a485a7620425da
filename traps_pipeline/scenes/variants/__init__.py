"""Make variants of a scenario, with other clips and questions: arms, variations."""
