"""The model f_theta: one definition of the physics for control, inference, gap and replay."""

from disco_hw.model.belief import Belief, Gaussian, Mixture, Uniform
from disco_hw.model.file import load_model, save_model
from disco_hw.model.model import EffectSetting, Model

__all__ = ["Belief", "EffectSetting", "Gaussian", "Mixture", "Model", "Uniform", "load_model", "save_model"]
