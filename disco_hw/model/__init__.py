"""The model f_theta: one definition of the physics for control, inference, gap and replay."""

from disco_hw.model.file import load_model, save_model
from disco_hw.model.model import Belief, EffectSetting, Gaussian, Mixture, Model, Uniform

__all__ = ["Belief", "EffectSetting", "Gaussian", "Mixture", "Model", "Uniform", "load_model", "save_model"]
