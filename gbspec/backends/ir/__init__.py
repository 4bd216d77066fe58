"""A Model as text, as the compiler understood it; `gbspec.ir.dumping` writes it."""
