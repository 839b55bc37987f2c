from qnerf.model.labels import labels, slug
from tests.helpers.configs import worked_out


def test_labels_come_from_resolved_values():
    typed = ("qiren=1L2S", "qiren.layers=3", "hash.levels=7", "field=qboth", "density.qiren.spectral=4")
    names = labels(worked_out(*typed).acting)
    assert names["qiren"] == "3L4S+3L2S"
    assert names["density"] == "3L4S"
    assert names["color"] == "3L2S"
    assert names["hash"] == "7-16-1024-15-1"
    assert names["field"] == "qboth"
    classical = labels(worked_out("field=classical", "encoder=pe").acting)
    assert not {"qiren", "hash"} & set(classical)


def test_the_slug_names_what_distinguishes_runs():
    name = slug(worked_out("field=classical", "scene=nerfstudio", "scene.path=/data/fox_64", "seed=2").acting)
    assert name == "fox_64-classical-hashC5-2x64-3x64-s2"
