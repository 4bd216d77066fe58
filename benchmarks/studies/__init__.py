"""Long studies; their results are committed as tables with the command that produced them."""
