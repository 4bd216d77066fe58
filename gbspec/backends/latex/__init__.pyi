from .equations import balances as balances
from .equations import expression as expression
from .equations import name as name
from .equations import observations as observations
from .equations import starts as starts
from .page import document as document
