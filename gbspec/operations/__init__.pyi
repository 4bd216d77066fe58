from .models import Subject as Subject
from .models import compile_file as compile_file
from .models import forms as forms
