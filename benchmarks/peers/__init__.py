"""The same work with other packages, written as their users would write it today."""
