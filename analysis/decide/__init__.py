"""As many seeds as it takes: `qnerf decide A B` trains until the verdict or the end of the budget.

- `looks`: when to look, what error rate each look may spend, races, collapses, the planner; pure statistics
- `study`: the question, its record in the store, the runs that belong to it
"""
