from .density import Density as Density
from .point import Evaluated as Evaluated
from .point import Given as Given
from .point import Value as Value
from .point import evaluate as evaluate
