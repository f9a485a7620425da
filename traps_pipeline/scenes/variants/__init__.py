"""Variants of a scenario, its further clips and questions: arms and variations."""
