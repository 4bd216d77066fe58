from .source import c_code as c_code
from .source import step as step
