from .importing import import_sbml as import_sbml
from .mathml import formula_of as formula_of
