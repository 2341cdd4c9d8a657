"""The words of the project: docstrings begin with a verb, and banned words stay out of code, messages and documents.

What is still to be rewritten is listed as an exception.
"""

import ast
import re
from pathlib import Path

from processes import ran

ROOT = Path(__file__).resolve().parents[1]
USER_WORDS = "cosfly/worldgen/words.yaml"  # the words of prompts
TO_REWRITE = ("tests/",)

VERBS = frozenset(
    """
    Abort Accept Add Adopt Advance Align Allow Answer Append Apply Ask Assert Assign Attach Average Await Begin
    Bind Blur Bound Break Bring Build Calculate Call Cancel Carry Cast Check Choose Clamp Classify Clear Clip
    Close Collect Color Colour Combine Compare Compile Compute Configure Connect Construct Contain Continue
    Convert Copy Count Cover Create Crop Cut Decide Decode Decorate Define Delete Derive Describe Detect Discard
    Display Divide Download Drain Draw Dress Drop Edit Encode End Enlarge Ensure Enter Enumerate Escape Estimate
    Evaluate Exchange Execute Exit Export Extend Extract Fetch Fill Filter Find Finish Fit Flag Flatten Fly
    Follow Format Forward Free Gather Generate Get Group Grow Guard Handle Hash Hide Hold Ignore Import Index
    Infer Initialize Insert Inspect Install Interpolate Interrupt Intersect Invert Iterate Join Keep Kill Label
    Launch Lay Limit Link List Load Locate Lock Log Look Lower Make Map Mark Mask Match Measure Merge Minimize
    Mirror Move Name Normalize Note Open Optimize Order Pack Pad Parse Pass Pause Perturb Place Plan Play Plot
    Pop Predict Prepare Prevent Print Process Produce Project Propose Publish Push Put Query Queue Raise Rank
    Rate Read Rebuild Receive Record Recover Reduce Refuse Register Reject Release Remove Rename Render Repair
    Repeat Replace Report Reproject Request Require Reserve Reset Resize Resolve Restart Restore Restrict Resume
    Retry Return Reverse Review Rotate Round Run Sample Save Scale Scan Score Search Select Send Separate Serve
    Set Shift Shorten Show Shuffle Shut Signal Simplify Simulate Skip Smooth Solve Sort Spawn Split Spread
    Standardize Start Steer Step Stop Store Stream Subtract Sum Summarize Switch Take Test Tick Tilt Track Train
    Transform Translate Triangulate Trim Try Turn Undo Unpack Update Upload Use Validate Verify View Visit Wait
    Walk Warn Watch Weigh Widen Wrap Write Yield
    """.split()  # noqa: SIM905
)

BANNED = re.compile(
    r"\b(anew|beside|whither|mend(s|ed|ing)?|look-alikes?|sign of life|of before|gone on with|taken up|left out|"
    r"that which|is told|are told|was told|is borne out|are borne out|stands? in for|who answers|what is said)\b",
    re.IGNORECASE,
)


def files(*endings: str) -> list[str]:
    listed = ran("git", "ls-files", cwd=ROOT).stdout.splitlines()
    return [name for name in listed if name.endswith(endings) and not name.startswith(TO_REWRITE)]


def first_words(source: str) -> list[tuple[str, str]]:
    found = []
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) or node.name.startswith("_"):
            continue
        is_property = any("property" in ast.unparse(decorator) for decorator in node.decorator_list)
        text = ast.get_docstring(node)
        if text and not is_property:
            found.append((node.name, text.split()[0].rstrip(",.:;")))
    return found


def banned_words(text: str) -> list[str]:
    return [match[0] for match in BANNED.finditer(text)]


def test_public_docstrings_begin_with_a_verb():
    wrong = [
        f"{name}: {function}: {word}"
        for name in files(".py")
        for function, word in first_words((ROOT / name).read_text(encoding="utf-8"))
        if word not in VERBS
    ]
    assert wrong == []


def test_banned_words_are_not_used():
    wrong = [
        f"{name}:{number}: {', '.join(words)}"
        for name in files(".py", ".md", ".html", ".js", ".yaml", ".css", "Makefile")
        if name != USER_WORDS
        for number, line in enumerate((ROOT / name).read_text(encoding="utf-8").splitlines(), 1)
        if (words := banned_words(line))
    ]
    assert wrong == []
