"""A Model as text; `gbspec.ir.dump` writes it."""
