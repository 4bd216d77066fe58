from .book import Happening as Happening
from .importing import Change as Change
from .importing import described_model as described_model
from .importing import import_sbml as import_sbml
from .mathml import NotOfferedError as NotOfferedError
from .mathml import formula_of as formula_of
from .reading import read_model as read_model
