"""A GPU to pretend: tensors on the CPU that claim to lie on CUDA, and complain when they meet one that does not.

It finds the mistake that code for a GPU usually has where no GPU ever runs it, a tensor left behind on the CPU.
"""

from collections.abc import Iterator
from typing import Any

import torch
from torch.overrides import TorchFunctionMode

MAY_MIX = ("__getitem__", "__setitem__", "copy_")
"""Indices may lie on the CPU, and copies go from anywhere to anywhere."""


class OnGpu(torch.Tensor):
    """A tensor that claims to lie on a GPU."""


class PretendGpu(TorchFunctionMode):
    """While it is entered, "cuda" is a device whose tensors are of class OnGpu."""

    def __torch_function__(self, function: Any, _: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run a function of PyTorch on the CPU, and give its result the class of the device it would lie on."""
        named = dict(kwargs or {})
        name = function.__name__
        with torch._C.DisableTorchFunctionSubclass():
            tensors = list(_tensors((args, named)))
            here = any(isinstance(t, OnGpu) for t in tensors)
            if name == "__get__" and function.__self__ is torch.Tensor.device:
                return torch.device("cuda:0" if here else "cpu")
            if name in ("to", "cpu"):
                return _moved(args[0], name, [*args[1:], *named.values()])
            if name == "numpy" and here:
                raise RuntimeError("numpy() of a tensor on the GPU")
            strangers = [t for t in tensors if not isinstance(t, OnGpu) and t.dim()]
            if here and strangers and name not in MAY_MIX and "__set__" not in name:
                raise RuntimeError(f"{name}: a tensor of shape {tuple(strangers[0].shape)} is on the CPU")
            if (device := named.pop("device", None)) is not None:
                here = torch.device(device).type == "cuda"
            return _labelled(function(*args, **named), here)


def to_pretended(module: torch.nn.Module, device: str) -> torch.nn.Module:
    """In the place of `torch.nn.Module.to`."""
    for part in module.modules() if torch.device(device).type == "cuda" else ():
        for name, tensor in [*part._parameters.items()]:
            part._parameters[name] = torch.nn.Parameter(tensor.detach().clone().as_subclass(OnGpu))
        for name, tensor in [*part._buffers.items()]:
            part._buffers[name] = tensor.clone().as_subclass(OnGpu)
    return module


def _moved(tensor: torch.Tensor, name: str, to: list[Any]) -> torch.Tensor:
    kinds = [a for a in to if isinstance(a, torch.dtype)]
    moved = tensor.as_subclass(torch.Tensor)
    moved = moved.to(kinds[0]) if kinds else moved.clone()
    places = [torch.device(a).type for a in to if isinstance(a, str | torch.device)]
    places += [a.device.type for a in to if isinstance(a, torch.Tensor)] + ["cpu"] * (name == "cpu")
    there = places[0] == "cuda" if places else isinstance(tensor, OnGpu)
    return moved.as_subclass(OnGpu if there else torch.Tensor)


def _labelled(result: Any, gpu: bool) -> Any:
    if isinstance(result, torch.Tensor):
        return result if isinstance(result, OnGpu) or not gpu else result.as_subclass(OnGpu)
    if isinstance(result, tuple | list) and gpu:
        parts = [_labelled(part, gpu) for part in result]
        return type(result)(*parts) if hasattr(result, "_fields") else type(result)(parts)
    return result


def _tensors(nested: Any) -> Iterator[torch.Tensor]:
    if isinstance(nested, torch.Tensor):
        yield nested
    elif isinstance(nested, list | tuple | dict):
        for part in nested.values() if isinstance(nested, dict) else nested:
            yield from _tensors(part)
