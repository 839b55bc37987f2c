"""As many seeds as it takes: `qnerf decide A B` trains until the verdict or the last look that the budget pays for."""
