"""Escape any text for LaTeX, such as the names of logs and estimators; pdflatex needs no package for it."""

from __future__ import annotations

import re
import unicodedata

ESCAPED = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "$": r"\$",
    "&": r"\&",
    "#": r"\#",
    "%": r"\%",
    "_": r"\_",
    "^": r"\textasciicircum{}",
    "~": r"\textasciitilde{}",
    "<": "$<$",
    ">": "$>$",
    "|": "$|$",
    '"': "''",
    "`": r"\`{}",
    "°": r"$^\circ$",
    "µ": r"$\mu$",
    "×": r"$\times$",
    "÷": r"$\div$",
    "±": r"$\pm$",
    "·": r"$\cdot$",
    "−": "$-$",
    "≤": r"$\leq$",
    "≥": r"$\geq$",
    "≈": r"$\approx$",
    "∞": r"$\infty$",
    "√": r"$\surd$",
    "→": r"$\rightarrow$",
    "←": r"$\leftarrow$",
    "–": r"\textendash{}",
    "—": r"\textemdash{}",
    "…": r"\dots{}",
    "‘": "`",
    "’": "'",
    "“": "``",
    "”": "''",
    "ß": r"\ss{}",
    "ø": r"\o{}",
    "Ø": r"\O{}",
    "æ": r"\ae{}",
    "Æ": r"\AE{}",
    "ł": r"\l{}",
    "Ł": r"\L{}",
    "ı": r"\i{}",
}
ACCENTS = {
    "\u0300": "`",
    "\u0301": "'",
    "\u0302": "^",
    "\u0303": "~",
    "\u0304": "=",
    "\u0306": "u",
    "\u0307": ".",
    "\u0308": '"',
    "\u030a": "r",
    "\u030b": "H",
    "\u030c": "v",
    "\u0327": "c",
}
"""Combining accents, as LaTeX's commands call them."""

ALPHABET = (
    "alpha beta gamma delta epsilon zeta eta theta iota kappa lamda mu nu xi pi rho sigma tau upsilon phi chi psi omega"
)
CAPITALS = "Gamma Delta Theta Lamda Xi Pi Sigma Upsilon Phi Psi Omega"
GREEK = {f"SMALL LETTER {name.upper()}": name.replace("lamda", "lambda") for name in ALPHABET.split()}
GREEK |= {f"CAPITAL LETTER {name.upper()}": name.replace("Lamda", "Lambda") for name in CAPITALS.split()}
"""By Unicode's names, without "GREEK"; LaTeX has only those capitals that differ from Latin letters."""


def escape(text: str) -> str:
    """Escape a text for LaTeX; a letter that LaTeX has no command for is shown by its code, [U+6771]."""
    escaped = "".join(_escape(letter) for letter in " ".join(text.split()))
    return re.sub("-(?=-)", "-{}", escaped)  # two hyphens would become a dash


def _escape(letter: str) -> str:
    if letter in ESCAPED:
        return ESCAPED[letter]
    if " " <= letter <= "~":
        return letter
    name = unicodedata.name(letter, "")
    greek = GREEK.get(name.removeprefix("GREEK "))
    if greek is not None:
        return f"$\\{greek}$"
    parts = unicodedata.normalize("NFKD", letter)
    if len(parts) == 2 and parts[1] in ACCENTS and parts[0].isascii() and parts[0].isalpha():
        return f"\\{ACCENTS[parts[1]]}{{{parts[0]}}}"
    if len(parts) == 1 and parts.isdecimal() and parts.isascii():  # ² and ₂
        return f"$^{parts}$" if "SUPERSCRIPT" in name else f"$_{parts}$" if "SUBSCRIPT" in name else parts
    return f"[U+{ord(letter):04X}]"
