"""Write tables as LaTeX.

The Styler of pandas does the same, but takes longer than all other work on a report's tables.
"""

from collections.abc import Sequence

from traps_pipeline.base.terminal import plain

LONG = 40  # rows of a table that fit on a page


def latex_table(
    caption: str, label: str, headings: Sequence[str], rows: Sequence[Sequence[str]], alignment: str
) -> str:
    """Return a floating `table` with booktabs rules, or a `longtable` of many rows.

    All texts are escaped. alignment: a letter per column.
    """
    head = ["\\toprule", f"{' & '.join(headings)} \\\\", "\\midrule"]
    body = [f"{' & '.join(row)} \\\\" for row in rows]
    if len(rows) <= LONG:
        lines = ["\\begin{table}[t]", "\\centering", f"\\caption{{{caption}}}", f"\\label{{{label}}}"]
        lines += [f"\\begin{{tabular}}{{{alignment}}}", *head, *body, "\\bottomrule", "\\end{tabular}", "\\end{table}"]
    else:
        lines = [f"\\begin{{longtable}}{{{alignment}}}", f"\\caption{{{caption}}} \\label{{{label}}} \\\\", *head]
        lines += ["\\endfirsthead", f"\\caption[]{{{caption}}} \\\\", *head, "\\endhead", "\\midrule"]
        lines += [f"\\multicolumn{{{len(headings)}}}{{r}}{{Continued on next page}} \\\\", "\\midrule", "\\endfoot"]
        lines += ["\\bottomrule", "\\endlastfoot", *body, "\\end{longtable}"]
    return "\n".join(lines) + "\n"


_LATEX = str.maketrans(
    {
        **{c: f"\\{c}" for c in "&%$#_{}"},
        "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "\\": r"\textbackslash{}",
        "<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}", '"': "''",
        "−": "$-$", "±": r"$\pm$", "×": r"$\times$", "∞": r"$\infty$", "≤": r"$\le$", "≥": r"$\ge$", "→": r"$\to$",
        "–": "--", "†": r"\dag{}", "‡": r"\ddag{}", "’": "'", "…": r"\ldots{}", "κ": r"$\kappa$", "α": r"$\alpha$",
        "Δ": r"$\Delta$", "≈": r"$\approx$", "∩": r"$\cap$", "↑": r"$\uparrow$", "↓": r"$\downarrow$",
    }
)  # fmt: skip


def latex(text: object) -> str:
    """Return the text with all LaTeX special characters escaped."""
    return latex_of_plain(plain(text))


def latex_of_plain(cell: str) -> str:
    """Escape printable text for LaTeX; hidden characters were escaped before."""
    return cell.translate(_LATEX)
