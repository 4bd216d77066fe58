from .form import make as make
