"""Evaluation by casadi: functions of a generated module over many points, and integration by CVODES."""
