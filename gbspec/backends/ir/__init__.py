"""A Model as text, as the compiler understood it; `gbspec.ir.dump` writes it."""
