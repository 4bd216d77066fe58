from .form import make as make
from .form import unchecked as unchecked
from .library import Library as Library
from .main import FINE as FINE
from .printer import number as number
from .printer import table as table
from .verifying import verify as verify
