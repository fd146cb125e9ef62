"""Writes the folders beside this file by TensorFlow itself: `PYTHONPATH=. python tests/data/deepmind/make.py`.

The folders that are kept here were written by TensorFlow 2.21.0. What is in them is made by `deepmind_samples`.
"""

import json
import sys
from pathlib import Path

import tensorflow as tf

FOLDER = Path(__file__).parent
sys.path.insert(0, str(FOLDER.parent))

from deepmind_samples import COUNTS, FAMILIES, meta, records  # noqa: E402


def example(arrays):
    features = {
        name: tf.train.Feature(bytes_list=tf.train.BytesList(value=[array.tobytes()])) for name, array in arrays.items()
    }
    return tf.train.Example(features=tf.train.Features(feature=features))


for family in FAMILIES:
    (FOLDER / family).mkdir(exist_ok=True)
    (FOLDER / family / "meta.json").write_text(json.dumps(meta(family), indent=1) + "\n")
    for split in COUNTS:
        with tf.io.TFRecordWriter(str(FOLDER / family / f"{split}.tfrecord")) as writer:
            for arrays in records(family, split):
                writer.write(example(arrays).SerializeToString())
print(f"written by TensorFlow {tf.__version__}")
