"""Long studies whose results are committed as tables beside the command that made them."""
