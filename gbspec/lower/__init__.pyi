from .command import lower_expression as lower_expression
from .statements import lower as lower
