"""What grader and student's process say to each other: plain JSON values with arrays in them, never a pickle.

A message is a frame of JSON, in which {"npy": i} stands for the i-th array, and then a frame of .npy for each array. A
frame is its length, eight bytes, and its bytes. The grader trusts nothing of it: all is checked before it is allocated.
"""
import io
import json
import struct

import numpy as np

LENGTH = struct.Struct("<Q")
MOST_FRAMES, MOST_JSON = 10_000, 1 << 20  # of a message; millions of tiny ones would fill the grader's memory


def frame(content):
    """The bytes of one frame. Not in the paper: a pipe knows no messages."""
    return LENGTH.pack(len(content)) + content


def frames(stream):
    """Split bytes into the contents of their frames -> list of memoryviews, and whether nothing is left over.

    Not in the paper: see `frame`.
    """
    stream, found, at = memoryview(stream), [], 0
    while at + LENGTH.size <= len(stream) and len(found) < MOST_FRAMES:
        end = at + LENGTH.size + LENGTH.unpack_from(stream, at)[0]
        if end > len(stream):
            break
        found.append(stream[at + LENGTH.size:end])
        at = end
    return found, at == len(stream)


def encode(value):
    """None, numbers, text, lists, tuples, dicts and arrays of numbers, nested -> bytes. A tuple becomes a list.

    Not in the paper: see the module. Raises TypeError for anything else, ValueError for arrays of objects.
    """
    arrays = []

    def known(other):
        if not isinstance(other, (np.ndarray, np.generic)):
            raise TypeError(f"value: expected numbers, text, lists, dicts or arrays, got {type(other).__name__}")
        file = io.BytesIO()
        np.save(file, np.ascontiguousarray(other).reshape(np.shape(other)), allow_pickle=False)
        arrays.append(file.getvalue())
        return {"npy": len(arrays) - 1}

    text = json.dumps(value, default=known)
    return frame(text.encode()) + b"".join(map(frame, arrays))


def load_npy(content):
    """The array in the bytes of a .npy file. Raises ValueError unless it has as many real numbers as it says.

    Not in the paper: a header may claim terabytes, or a type that runs code; what came is all that is allocated.
    """
    file = io.BytesIO(content)
    version = np.lib.format.read_magic(file)
    if version != (1, 0):
        raise ValueError(f"array: expected .npy of version 1.0, got {version}")
    shape, fortran, dtype = np.lib.format.read_array_header_1_0(file)
    if dtype.kind not in "biuf" or dtype.itemsize > 8 or not all(0 <= n < 2 ** 40 for n in shape) or len(shape) > 16:
        raise ValueError(f"array: expected real numbers of at most 8 bytes, got {dtype} of shape {shape}")
    flat = np.frombuffer(content, dtype, offset=file.tell()).copy()  # aligned, and writable
    return flat.reshape(shape, order="F" if fortran else "C")


def decode(contents):
    """The frames of one message -> its value. Raises ValueError for whatever is wrong with it.

    Not in the paper: see the module.
    """
    try:
        if len(contents[0]) > MOST_JSON:
            raise ValueError(f"expected at most {MOST_JSON} bytes of JSON, got {len(contents[0])}")
        arrays = [load_npy(content) for content in contents[1:]]
        return json.loads(bytes(contents[0]),
                          object_hook=lambda each: arrays[each["npy"]] if [*each] == ["npy"] else each)
    except Exception as error:  # damage can surface as almost anything: struct, JSON, MemoryError for a deep nesting
        raise ValueError(f"message: {error or type(error).__name__}") from None
