from .form import make as make
from .form import unchecked as unchecked
from .library import Library as Library
from .main import FINE as FINE
from .verifying import verify as verify
