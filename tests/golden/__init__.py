"""The golden corpus: whole commands and live fusions, and what each of them gave when recorded.

``commands.yaml`` and ``live.yaml`` list the entries; ``expected/NAME.txt`` holds what an entry
printed, its exit code, and a line or a text for each file that it wrote. Maps and paths appear with
their size, a few numbers and a digest. Durations, memory, versions, devices and absolute paths are
masked.

    python -m tests.golden                      check every entry; exit code 1 where one differs
    python -m tests.golden NAME ...             check these entries
    python -m tests.golden --record             record every entry
    python -m tests.golden --record NAME ...    record these entries

The same input gives the same bytes on one processor with one OpenCL driver and one NumPy. Another
processor may round the last digit differently. ``recorded.json`` therefore holds the processor, the
device and the versions of the recording. On the same ones the texts must be equal; on others every
word must be equal, numbers may differ by 5 %, and digests are not compared. A part that takes
seconds runs in the test suite (``test_golden.py``), the rest there with ``--full``.

A difference that is wanted is recorded again, and the commit says why it is right.
"""
