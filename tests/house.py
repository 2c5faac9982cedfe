"""Measure the size and the prose of the house: `./dev house` prints them beside their budgets."""

import argparse
import ast
import re
import sys
import tomllib
from collections import Counter
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
BUDGETS = Path(__file__).with_suffix(".toml")
GLOSSARY = ROOT / "docs" / "glossary.toml"

SLACK = 0.02
"""How far a measure may fall below its budget, as a share of the budget, before it is lowered."""

RULES = {
    "R1 nominal what": r"\bwhat\b(?! to\b)",
    "R2 tell, say": r"\b(tells?|told|says?|said)\b",
    "R3 who, nobody": r"\b(who|whom|whose|whoever|nobody|anybody|somebody)\b",
    "R4 of which": r"\b(of|by|in|from|to|with|on|at) (which|whom)\b",
    "R5 those, that of": r"\bthose\b|\bthat of\b|\bas one\b",
    "R6 alone, anew": r"\b(alone|anew|alike|likewise|apart|beside)\b",
    "R7 hang, stand, lie": r"\b(hangs?|stands?|lies?|lay|laid|bears?|throws?|thrown)\b",
    "R8 its own": r"\b(its|their|one's|our|his) own\b",
    "R9 one": r"\b(each|every|this|that|the|no|which|any|some|another) one\b"
    r"|\bones?\b(?= (that|which|is|are|has))",
    "R10 as it is": r"\bas (it|they|one|these|those) (is|was|are|were|has|have|do|does)\b",
    "R11 too, more": r", too\b|\b(range|row|slot|landmark|step)s? more\b",
}
"""Constructions that a first line, a text of a setting and the name of a test avoid."""

IDIOM = re.compile(
    r"\bwhat\b|\b(who|whom|whose|whoever)\b|\b(nobody|somebody|anybody|everybody)\b"
    r"|\b(tells?|told|telling)\b|\b(says?|said)\b|\bhangs? on\b"
    r"|\b(of|by|in|from|to|with|on) (which|whom)\b|\banew\b|\balone\b|\bstands?\b"
    r"|\b(alike|likewise)\b|\bthose\b|\bbut for\b|, too\b|\bone\b|\bbears?\b|\bapart\b"
    r"|\bas (it|they) (is|was|are|were|has|have)\b",
    re.IGNORECASE,
)
"""Words that are counted in whole docstrings and in pages."""

TEST = re.compile(r" *def (test_\w+)\(")
"""The line that begins a test."""

LEANING = re.compile(r"(Of|Or|Else|The same|As above)\b")
"""How the text of a setting begins if it needs the text before it."""


class Flagged(NamedTuple):
    """A line that breaks rules of prose."""

    where: str
    text: str
    rules: list[str]


class House(NamedTuple):
    """The measures by name, and the lines that were flagged."""

    measures: dict[str, float]
    flagged: list[Flagged]


def broken_rules(line: str) -> list[str]:
    """Return the names of the rules that a line breaks."""
    return [name for name, rule in RULES.items() if re.search(rule, line, re.IGNORECASE)]


@cache
def replaced_words() -> dict[re.Pattern[str], str]:
    """Return a pattern for the words that each term of the glossary replaces, with the term."""
    entries = tomllib.loads(GLOSSARY.read_text(encoding="utf-8"))["term"]
    words = {entry["term"]: "|".join(map(re.escape, entry.get("never", ()))) for entry in entries}
    return {re.compile(rf"\b({w})\b", re.IGNORECASE): term for term, w in words.items() if w}


def against_glossary(where: str, text: str) -> list[Flagged]:
    """Return a flag for each word in a text that the glossary replaces."""
    return [
        Flagged(where, text, [f"glossary: {word[0]}, say {term}"])
        for pattern, term in replaced_words().items()
        for word in pattern.finditer(text)
    ]


def is_record(node: ast.AST) -> bool:
    """Return whether a node is a dataclass or a named tuple."""
    return isinstance(node, ast.ClassDef) and (
        any("dataclass" in ast.dump(decorator) for decorator in node.decorator_list)
        or any("NamedTuple" in ast.dump(base) for base in node.bases)
    )


def docstring_lines(tree: ast.Module) -> set[int]:
    """Return the numbers of the lines of all bare strings: docstrings, and texts below fields."""
    bodies = (getattr(node, "body", None) for node in ast.walk(tree))
    strings = (
        statement
        for body in bodies
        if isinstance(body, list)
        for statement in body
        if isinstance(statement, ast.Expr)
        and isinstance(statement.value, ast.Constant)
        and isinstance(statement.value.value, str)
    )
    return {line for text in strings for line in range(text.lineno, (text.end_lineno or 0) + 1)}


def numeric_constants(tree: ast.Module) -> int:
    """Count the upper-case names of a module that are given numbers."""
    count = 0
    for node in tree.body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = [
                part
                for target in targets
                for part in ast.walk(target)
                if isinstance(part, ast.Name) and part.id.strip("_").isupper()
            ]
            numbers = [
                part
                for part in ast.walk(node.value)
                if isinstance(part, ast.Constant) and type(part.value) in (int, float)
            ]
            count += min(len(names), len(numbers))
    return count


def docstrings(tree: ast.Module) -> Iterator[tuple[int, str, str]]:
    """Yield line, name and docstring of a module, its classes and its functions."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node)
            if text:
                yield getattr(node, "lineno", 1), getattr(node, "name", "(module)"), text


@cache
def docstrings_of(path: Path) -> tuple[str, ...]:
    """Return the docstrings of a file."""
    return tuple(text for _, _, text in docstrings(ast.parse(path.read_text(encoding="utf-8"))))


def texts_of_fields(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield line and text of each documented field."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef):
            for field, text in zip(node.body, node.body[1:], strict=False):
                if (
                    isinstance(field, ast.AnnAssign)
                    and isinstance(text, ast.Expr)
                    and isinstance(text.value, ast.Constant)
                ):
                    yield text.lineno, str(text.value.value)


def imported(tree: ast.Module, module: str, modules: set[str], package: bool) -> set[str]:
    """Return the modules of the package that a module imports, in functions as well."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = module.split(".")[: len(module.split(".")) - node.level + package]
            base = ".".join(above) if node.level else ""
            base = ".".join(part for part in (base, node.module or "") if part)
            within = {f"{base}.{alias.name}" for alias in node.names}
            names |= {name if name in modules else base for name in within}
    return (names & modules) - {module}


def files_in_cycles(graph: dict[str, set[str]]) -> int:
    """Count the modules that import themselves by way of others."""

    @cache
    def reached(module: str) -> frozenset[str]:
        seen, open_ends = set(), list(graph[module])
        while open_ends:
            end = open_ends.pop()
            if end not in seen:
                seen.add(end)
                open_ends += graph[end]
        return frozenset(seen)

    return sum(module in reached(module) for module in graph)


def idiom_per_1000_words(texts: Iterable[str]) -> float:
    """Return how often the words of `IDIOM` occur in texts without code, per 1,000 words."""
    text = re.sub(r"(?ms)^```.*?^```|^\s*(>>>|\.\.\.)[^\n]*$", "", "\n".join(texts))
    words = re.findall(r"[A-Za-z][A-Za-z'-]*", text)
    return round(1000 * len(IDIOM.findall(text)) / max(len(words), 1), 1)


def measure(root: Path = ROOT) -> House:
    """Measure `src`, `tests` and the pages below a folder."""
    count: Counter[str] = Counter()
    texts: list[str] = []
    flagged, replaced = [], []
    source = root / "src" / "pipistrelle"
    paths = sorted(source.rglob("*.py"))
    names = {".".join(path.relative_to(root / "src").with_suffix("").parts): path for path in paths}
    modules = {name.removesuffix(".__init__"): path for name, path in names.items()}
    graph = {}
    for module, path in modules.items():
        text = path.read_text(encoding="utf-8")
        tree, rows, room = ast.parse(text), text.splitlines(), module.split(".")[1:2]
        strings = docstring_lines(tree)
        count["files"] += 1
        count["lines"] += len(rows)
        count["code lines"] += sum(
            number not in strings and bool(row.strip()) and not row.strip().startswith("#")
            for number, row in enumerate(rows, start=1)
        )
        count["records"] += sum(is_record(node) for node in ast.walk(tree))
        count["numeric constants"] += numeric_constants(tree)
        graph[module] = imported(tree, module, set(modules), path.name == "__init__.py")
        in_a_room = room[0] if (source / "".join(room)).is_dir() and room else "top level"
        count[f"first lines of {in_a_room}"] += 0
        place = path.relative_to(root).as_posix()
        for line, name, docstring in docstrings(tree):
            first = docstring.split("\n")[0]
            texts.append(docstring)
            if rules := broken_rules(first):
                count[f"first lines of {in_a_room}"] += 1
                flagged.append(Flagged(f"{place}:{line} {name}", first, rules))
            replaced += against_glossary(f"{place}:{line} {name}", first)
        if module == "pipistrelle.config":
            for line, text in texts_of_fields(tree):
                if LEANING.match(text):
                    count["leaning texts of settings"] += 1
                    first = text.splitlines()[0]
                    flagged.append(Flagged(f"{place}:{line}", first, ["leans on a neighbour"]))
                replaced += against_glossary(f"{place}:{line}", text)
    others = (path for path in source.rglob("*.*") if path.suffix[:3] != ".py")
    count["lines of other files"] = sum(path.read_bytes().count(b"\n") for path in others)
    for path in sorted((root / "tests").rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        count["lines of tests"] += text.count("\n")
        for number, row in enumerate(text.splitlines(), start=1):
            name = TEST.match(row)
            if name and (rules := broken_rules(name[1].replace("_", " "))):
                count["names of tests"] += 1
                where = f"{path.relative_to(root).as_posix()}:{number}"
                flagged.append(Flagged(where, name[1], rules))
    measures: dict[str, float] = dict.fromkeys(budgets(), 0) | count
    measures["words against the glossary"] = len(replaced)
    measures["files in cycles of imports"] = files_in_cycles(graph)
    measures["idiom per 1,000 words"] = idiom_per_1000_words(texts)
    pages = (*root.glob("README.md"), *sorted((root / "docs").glob("*.md")))
    texts = [page.read_text(encoding="utf-8") for page in pages]
    measures["idiom of pages per 1,000 words"] = round(idiom_per_1000_words(texts))
    return House(measures, flagged + replaced)


def budgets(text: str | None = None) -> dict[str, float]:
    """Return the budget of each measure."""
    table = tomllib.loads(BUDGETS.read_text(encoding="utf-8") if text is None else text)
    return {key: value for part in table.values() for key, value in part.items()}


def floor(budget: float) -> float:
    """Return the smallest measure that its budget may have."""
    return budget * (1 - SLACK)


def lower(measures: dict[str, float]) -> None:
    """Lower the budgets to the measures, where these are smaller."""
    text = BUDGETS.read_text(encoding="utf-8")
    for name, budget in budgets(text).items():
        if measures[name] < budget:
            key = re.escape(name if re.fullmatch(r"[\w-]+", name) else f'"{name}"')
            text = re.sub(rf"(?m)^({key} = ).*$", rf"\g<1>{measures[name]}", text)
    BUDGETS.write_text(text, encoding="utf-8")


def main() -> None:
    """Print the measures beside their budgets."""
    parser = argparse.ArgumentParser(prog="./dev house", description=__doc__)
    parser.add_argument("--lines", action="store_true", help="list the lines that are flagged")
    parser.add_argument("--lower", action="store_true", help="lower the budgets to the measures")
    asked = parser.parse_args()
    measures, flagged = measure()
    if asked.lines:
        for line in flagged:
            print(f"{line.where} | {line.text} | {', '.join(line.rules)}")
    if asked.lower:
        lower(measures)
    over = 0
    print(f"{'':34}{'now':>9}{'budget':>9}")
    for name, budget in budgets().items():
        now = measures[name]
        over += now > budget
        note = "over" if now > budget else "lower the budget" if now < floor(budget) else ""
        print(f"{name:34}{now:>9,}{budget:>9,}  {note}".rstrip())
    sys.exit(bool(over))


if __name__ == "__main__":
    main()
