from . import analysing as analysing
from . import fitting as fitting
from . import models as models
from . import reporting as reporting
from . import tables as tables
from .models import Subject as Subject
from .models import compile_file as compile_file
from .models import forms as forms
