"""What is measured on a solved contact, in the distributed run.  `Observer` measures everything that a job asks for."""

from .observer import Observer

__all__ = ["Observer"]
