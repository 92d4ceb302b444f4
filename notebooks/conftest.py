"""How nbval compares the notebooks' outputs."""


def pytest_collectstart(collector):
    """Leave out stderr: warnings and progress of libraries differ from machine to machine, results must not."""
    if hasattr(collector, "skip_compare"):
        collector.skip_compare += ("stderr",)
