from .design import Boxes as Boxes
from .design import Plan as Plan
from .design import boxes as boxes
from .design import plan as plan
from .region import Region as Region
from .region import regions as regions
