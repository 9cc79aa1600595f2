"""The pose-driven baseline: the best rate is trained on, and Gaussians may leave the template far."""

import dataclasses

import numpy as np
import pytest

from avatarjax.train import Run, StageConfig
from avatarjax.unica.baselines import pose_driven
from avatarjax.unica.config import preset


def test_the_rate_with_the_lowest_loss_gets_all_steps(tiny_data, upscaler, base, monkeypatch, tmp_path):
    config = dataclasses.replace(preset("ci"), texels_stage=StageConfig(40, 1, 1.0))
    calls = []

    def train_texels(config, data, run, upscaler, base, perceptual, *, surfaces):
        rate = config.texels_stage.learning_rate
        calls.append((config.texels_stage.steps, rate))
        run.folder.mkdir(parents=True)
        loss = abs(np.log(rate / pose_driven.RATES[2]))
        (run.folder / "texels.jsonl").write_text(f'{{"loss": 9}}\n{{"loss": {loss}}}\n')
        assert config.texel_head.offset_bound == pose_driven.REACH
        return {"rate": rate}, base

    monkeypatch.setattr(pose_driven, "train_texels", train_texels)
    surfaces = tiny_data.train_images.texels
    params, _ = pose_driven.train(config, tiny_data, Run(tmp_path, 0, "x"), upscaler, base, surfaces)
    assert params == {"rate": pose_driven.RATES[2]}
    assert calls == [(10, rate) for rate in pose_driven.RATES] + [(40, pose_driven.RATES[2])]


def test_only_the_reach_differs_from_the_texel_head():
    config = preset("small")
    changed = pose_driven.pose_driven(config)
    back = dataclasses.replace(changed, texel_head=config.texel_head)
    assert back == config and changed.texel_head.offset_bound == pytest.approx(0.3)
