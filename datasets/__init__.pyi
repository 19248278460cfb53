from .load import load_scene as load_scene
from .scene import Scene as Scene
from .scene import Views as Views
from .synthetic import synthetic_scene as synthetic_scene
