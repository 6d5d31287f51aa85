"""The rows of the risk page, from tables, tests and the fault matrix, and how they are shown."""
