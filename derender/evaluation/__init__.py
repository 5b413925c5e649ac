"""How good an answer is: matching, metrics, truth files.

Scenes are the dictionaries that `derender show --json` prints (see `derender.report.scene_json`), so that the answer of
another system can be judged as well as ours.
"""
