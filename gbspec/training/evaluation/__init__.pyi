from .density import Density as Density
from .integrated import evaluate_integral as evaluate_integral
from .integrated import parameters_of as parameters_of
from .point import Evaluated as Evaluated
from .point import Given as Given
from .point import Value as Value
from .point import evaluate as evaluate
