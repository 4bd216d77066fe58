from .document import Document as Document
from .form import make as make
from .form import remarks as remarks
from .formulas import Names as Names
from .networks import Applications as Applications
from .networks import Steps as Steps
