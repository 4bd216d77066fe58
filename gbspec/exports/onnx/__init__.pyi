from .form import make as make
from .form import parts as parts
