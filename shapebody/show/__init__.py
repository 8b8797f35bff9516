"""Tables, figures, pictures, videos and scenes."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submodules=[
        "diagrams",
        "notebook",
        "opengl",
        "plots",
        "render",
        "scene",
        "software_renderer",
        "study_plots",
        "tables",
        "video",
    ],
)
