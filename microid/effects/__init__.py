"""Physical effects that the plain stage lacks, one file each.

Importing the package imports every sibling whose name does not start with an underscore; each registers itself.
"""

from microid._plugins import plugins as _plugins
from microid.effects._base import EFFECTS as EFFECTS
from microid.effects._base import PLACES as PLACES
from microid.effects._base import AbstractEffect as AbstractEffect
from microid.effects._base import Place as Place
from microid.effects._base import Scales as Scales
from microid.effects._base import Statistic as Statistic
from microid.effects._base import View as View
from microid.effects._base import card_of as card_of
from microid.effects._base import extend as extend
from microid.effects._base import host as host
from microid.effects._base import register as register

_plugins(__name__, __path__)
