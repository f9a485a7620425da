"""Further clips and questions of a scenario: arms and variations."""
