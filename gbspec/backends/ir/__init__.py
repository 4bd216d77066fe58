"""A Model as text; `gbspec.ir.dumping` writes it."""
