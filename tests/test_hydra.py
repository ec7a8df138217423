"""What acmr/settings uses of Hydra's inside; nothing of acmr is imported here, so that this can say so."""

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


def test_hydra_has_the_private_parts_that_find_settings_files():
    loader = import_module("hydra._internal.config_loader_impl").ConfigLoaderImpl
    search_path = import_module("hydra._internal.config_search_path_impl").ConfigSearchPathImpl
    parser = import_module("hydra._internal.utils").get_args_parser
    advice = f"acmr/settings/sources.py is made for hydra-core 1.3.8; {metadata.version('hydra-core')} is installed"
    assert list(inspect.signature(loader).parameters) == ["config_search_path"], advice
    assert list(inspect.signature(search_path.append).parameters)[:3] == ["self", "provider", "path"], advice
    assert {"config_dir", "config_path", "config_name", "overrides"} <= set(vars(parser().parse_args([]))), advice
