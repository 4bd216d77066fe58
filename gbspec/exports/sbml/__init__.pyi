from .document import Document as Document
from .form import make as make
from .form import remarks as remarks
