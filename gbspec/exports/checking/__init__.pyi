from .comparison import Quantity as Quantity
from .comparison import compare as compare
from .comparison import require as require
from .points import Points as Points
from .points import draw as draw
from .points import own as own
from .reference import Course as Course
from .reference import Reference as Reference
