from pipistrelle.config import Config as Config
from pipistrelle.config import InputError as InputError
from pipistrelle.scripting.hearing import hear as hear
from pipistrelle.scripting.live import Slam as Slam
from pipistrelle.scripting.results import load as load
from pipistrelle.scripting.results import run as run
from pipistrelle.scripting.results import slam as slam
from pipistrelle.scripting.studies import study as study

__version__: str
