"""How a user would run the same circuit with other packages today."""
