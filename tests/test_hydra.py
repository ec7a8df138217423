"""What acmr/settings/compose.py uses of Hydra's inside; nothing of acmr is imported here, so that this can say so."""

import inspect
from importlib import import_module, metadata


def test_hydra_has_the_private_function_that_compose_uses():
    place = "hydra._internal.config_loader_impl.ConfigLoaderImpl._apply_overrides_to_config"
    advice = (
        f"acmr/settings/compose.py sets values with {place}, as hydra-core 1.3.8 has it; "
        f"{metadata.version('hydra-core')} is installed and has another one or none"
    )
    try:
        module = import_module("hydra._internal.config_loader_impl")
    except ImportError:
        module = None
    function = getattr(getattr(module, "ConfigLoaderImpl", None), "_apply_overrides_to_config", None)
    assert function is not None, advice
    assert list(inspect.signature(function).parameters) == ["overrides", "cfg"], advice
