"""`pav doctor --compile`: kernels compiled ahead of their use."""

from __future__ import annotations

from pav_blender.cli import main


def test_kernels_are_compiled_ahead(capsys):
    from pav_blender.core.kernels.cpu import encoding, mlp, picking

    assert main(["doctor", "--compile"]) == 0
    assert "compiled" in capsys.readouterr().out
    for function in (picking._pick, mlp._forward_samples, encoding._encode_levels):
        assert function.signatures
