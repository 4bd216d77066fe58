"""Figures of fits, learned functions, constants, histories, residuals and phase planes."""
