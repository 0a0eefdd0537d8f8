"""Models of a piezo-driven micro-positioner as pure, differentiable JAX functions."""

from microid._everett import Everett as Everett
from microid._everett import everett as everett
from microid._forest import forest_sum as forest_sum
from microid._memory import Memory as Memory
from microid._memory import Staircase as Staircase
from microid._memory import demagnetised as demagnetised
from microid._memory import negative_saturation as negative_saturation
from microid._memory import positive_saturation as positive_saturation
from microid._memory import remember as remember
from microid._param import Coordinates as Coordinates
from microid._param import ParameterInfo as ParameterInfo
from microid._param import ParameterSpec as ParameterSpec
from microid._param import array as array
from microid._param import param as param
from microid._param import parameter_table as parameter_table
from microid._param import static as static
from microid._preisach import Preisach as Preisach
from microid._reversible import Reversible as Reversible
from microid.densities import FAMILIES as FAMILIES
from microid.densities import AbstractDensity as AbstractDensity
from microid.densities._base import node_areas as node_areas
from microid.densities.grid import GridDensity as GridDensity
from microid.densities.mixture import MixtureDensity as MixtureDensity
from microid.densities.network import NetworkDensity as NetworkDensity
