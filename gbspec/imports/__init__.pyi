from .description import Imported as Imported
from .description import LeftOut as LeftOut
from .petab.importing import import_petab as import_petab
from .safety import MOST_BYTES as MOST_BYTES
from .sbml.importing import import_sbml as import_sbml
from .writing import Written as Written
from .writing import written as written
