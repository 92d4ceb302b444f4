"""Drawing: every function returns a Figure."""

import os
import sys
import warnings


def _import_matplotlib() -> None:
    """Import it with the backend that MPLBACKEND names, or with Agg where that cannot be used here.

    It is often another environment's, such as a notebook's, and a figure that is only written needs no window.
    """
    loaded, wanted = "matplotlib" in sys.modules, os.environ.pop("MPLBACKEND", "")  # unknown, it would end the import
    from matplotlib import get_backend, pyplot

    backend = get_backend(auto_select=False) if loaded else wanted
    try:
        if backend and not pyplot.get_fignums():
            pyplot.switch_backend(backend)
    except (ImportError, ValueError) as error:
        wanted = "Agg"
        pyplot.switch_backend(wanted)
        warnings.warn(f"the backend {backend} of MPLBACKEND cannot be used here, Agg is: {error}", stacklevel=2)
    finally:
        os.environ |= {"MPLBACKEND": wanted} if wanted else {}


try:
    _import_matplotlib()
    import seaborn  # noqa: F401  # brings pandas
except ModuleNotFoundError as error:
    hint = f"{error.name} is not installed: pip install 'mmgsd[plot]' brings it"
    raise ModuleNotFoundError(hint, name=error.name) from error
