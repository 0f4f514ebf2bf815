"""Fields emit finished edits only, keep the last valid value, and describe invalid input."""

import math

import pytest
from PySide6.QtCore import QCoreApplication, Qt
from PySide6.QtGui import QGuiApplication

from labapp.gui.digits import ResultRow, as_csv, entered, parsed
from labapp.gui.widgets.fields import ChoiceField, FieldForm, NumberField, TextField
from labapp.gui.widgets.labels import heading
from labapp.gui.widgets.path_field import PathField, PathLine
from labapp.gui.widgets.result_table import ResultTable
from labapp.text import NOTHING, plain, rounded


@pytest.mark.parametrize(
    ("value", "sigma", "texts"),
    [
        (27.1234, 0.0312, ("27.123", "0.031")),
        (27.1234, 0.0996, ("27.12", "0.10")),
        (27.1234, 0.31, ("27.12", "0.31")),
        (1234.5, 120.0, ("1230", "120")),
        (-0.00004, 0.01, ("0.000", "0.010")),
        (-2.5, None, ("−2.500", "")),
        (2.5, 0.0, ("2.500", "")),
        (None, 0.1, (NOTHING, "")),
        (math.nan, None, (NOTHING, "")),
    ],
)
def test_value_is_rounded_to_its_sigma(value, sigma, texts):
    assert rounded(value, sigma) == texts


def test_typed_numbers_are_shown_in_full_and_computed_ones_rounded():
    assert entered(0.77, 2) == "0.77"
    assert entered(38.6, 2) == "38.60"
    assert entered(0.7735, 2) == "0.7735"
    assert entered(38.6 / 7, 2) == "5.51"
    assert entered(19, 0) == "19"
    assert plain(-0.001, 2) == "0.00"


def test_numbers_accept_point_or_comma_and_either_minus():
    assert parsed(" 27,5 ") == parsed("27.5") == 27.5
    assert parsed("−3") == -3
    assert parsed("0,125") == parsed("−0,125e0") * -1 == 0.125
    assert parsed("１２，５".replace("，", ",")) == 12.5
    for text in ("", "x", "1 2", "1_0", "nan", "inf", "5 mm", "1 000", "1.000,5", "1,000.5"):
        assert parsed(text) is None


@pytest.mark.parametrize(
    ("text", "highest", "value"),
    [
        ("1,250", 1e4, None),
        ("+１,２５０", 1e4, None),
        ("1,250e1", 1e5, None),
        ("1,250", 90, None),  # 1250 is not read as 1.25 where it is out of range
        ("0,250", 1e4, 0.25),
        ("1,25", 1e4, 1.25),
        ("1.250", 1e4, 1.25),
    ],
)
def test_comma_that_may_separate_thousands_is_refused(qtbot, text, highest, value):
    field = NumberField("Distance", "mm", lowest=0, highest=highest)
    qtbot.addWidget(field)
    field.set_value(7.0)
    paste(field, text)
    field.flush()
    assert field.value() == (7.0 if value is None else value)
    assert (text in field.problem.text()) == (value is None)


@pytest.mark.parametrize("text", ["1,000", "1.000", "1 000", "1,0", "1.", "１．０００", "12 px"])
def test_whole_number_has_digits_only(qtbot, text):
    field = NumberField("Frames", lowest=1, highest=10**9, decimals=0)
    qtbot.addWidget(field)
    field.set_value(7)
    emitted = []
    field.edited.connect(emitted.append)
    paste(field, text)
    field.flush()
    assert not emitted
    assert field.value() == 7
    assert text in field.problem.text()
    retype(qtbot, field, "1e3")
    field.flush()
    assert emitted == [1000]


def test_csv_has_the_numbers_in_full_precision():
    rows = [ResultRow("angle", 27.123456, 0.03, "°"), ResultRow('a "b", c', None)]
    lines = as_csv(rows).splitlines()
    assert lines == ["quantity,value,sigma,unit", "angle,27.123456,0.03,°", '"a ""b"", c",,,']


@pytest.fixture
def number(qtbot):
    field = NumberField("Angle", "°", lowest=0, highest=90, decimals=2, tooltip="Of the laser")
    qtbot.addWidget(field)
    field.set_value(27.0)
    field.show()
    field.received = []
    field.edited.connect(field.received.append)
    return field


def retype(qtbot, field, text):
    box = field.editor
    box.setFocus()
    box.selectAll()
    qtbot.keyClicks(box, text)


def paste(field, text):
    QGuiApplication.clipboard().setText(text)
    field.editor.selectAll()
    field.editor.lineEdit().paste()


def test_number_is_emitted_when_editing_is_finished(qtbot, number):
    retype(qtbot, number, "30,5")
    assert number.received == []
    qtbot.keyClick(number.editor, Qt.Key.Key_Return)
    assert number.received == [30.5]
    assert number.editor.text() == "30.50"
    qtbot.keyClick(number.editor, Qt.Key.Key_Return)
    assert number.received == [30.5]


def test_leaving_a_rounded_number_keeps_its_value(qtbot, number):
    number.set_value(27.123456789)
    number.editor.setFocus()
    qtbot.keyClick(number.editor, Qt.Key.Key_Return)
    assert number.received == []
    assert number.value() == 27.123456789


@pytest.mark.parametrize(
    ("text", "words"),
    [("abc", "not a number"), ("91", "from 0 to 90 °"), ("", "is needed"), ("1e999", "not a")],
)
def test_invalid_number_is_reported_and_the_value_kept(qtbot, number, text, words):
    retype(qtbot, number, text)
    if not text:
        number.editor.clear()
    qtbot.keyClick(number.editor, Qt.Key.Key_Return)
    assert number.received == []
    assert number.value() == 27.0
    assert number.editor.text() == "27.00"
    assert words in number.problem.text()
    assert words in number.editor.accessibleDescription()
    assert not number.problem.isHidden()
    number.set_value(28.0)
    assert number.problem.isHidden()


def test_problem_is_shown_until_the_field_is_corrected(qtbot, number):
    retype(qtbot, number, "abc")
    qtbot.keyClick(number.editor, Qt.Key.Key_Return)
    number.set_value(27.0)  # as a page does after another field was accepted
    number.set_problem("")
    number.flush()
    assert "not a number" in number.problem.text()
    assert not number.problem.isHidden()
    retype(qtbot, number, "27.00")  # the value that is set already is accepted, too
    qtbot.keyClick(number.editor, Qt.Key.Key_Return)
    assert number.problem.isHidden()
    retype(qtbot, number, "91")
    qtbot.keyClick(number.editor, Qt.Key.Key_Return)
    number.set_problem("it is missing")
    assert "from 0 to 90" in number.problem.text()
    retype(qtbot, number, "30")
    qtbot.keyClick(number.editor, Qt.Key.Key_Return)
    assert "it is missing" in number.problem.text()
    number.set_value(30.0)
    assert number.problem.isHidden()
    retype(qtbot, number, "91")
    qtbot.keyClick(number.editor, Qt.Key.Key_Return)
    qtbot.keyClick(number.editor, Qt.Key.Key_Up)
    assert number.problem.isHidden()


def test_consecutive_steps_are_one_edit(qtbot, number):
    number.editor.setFocus()
    for _ in range(3):
        qtbot.keyClick(number.editor, Qt.Key.Key_Up)
    assert number.editor.text() == "30.00"
    assert number.received == []
    number.set_value(27.0)  # a refresh in between
    qtbot.waitUntil(lambda: number.received == [30.0])
    for _ in range(8):
        qtbot.keyClick(number.editor, Qt.Key.Key_PageUp)
    number.flush()
    assert number.received == [30.0, 90.0]


def test_refresh_keeps_text_being_typed(qtbot, number):
    number.activateWindow()
    qtbot.waitUntil(number.isActiveWindow)
    retype(qtbot, number, "30")
    number.set_value(27.0)
    assert number.editor.text() == "30"
    qtbot.keyClick(number.editor, Qt.Key.Key_Return)
    assert number.received == [30.0]


def test_integer_and_empty_numbers(qtbot):
    field = NumberField("Rows", lowest=3, highest=99, step=2, decimals=0, optional=True)
    qtbot.addWidget(field)
    emitted = []
    field.edited.connect(emitted.append)
    retype(qtbot, field, "19")
    field.flush()
    retype(qtbot, field, "19.5")
    field.flush()
    assert "whole" in field.problem.text()
    field.editor.clear()
    field.flush()
    assert emitted == [19, None]
    assert type(emitted[0]) is int


@pytest.mark.parametrize(
    ("field", "old", "typed", "new"),
    [
        (lambda: NumberField("Angle", lowest=0, highest=90), 30.0, "27.5", 27.5),
        (lambda: TextField("Title"), "old", "new", "new"),
        (lambda: TextField("Notes", lines=3), "old", "new", "new"),
    ],
)
def test_refresh_of_an_inactive_window_keeps_typed_text(qtbot, field, old, typed, new):
    widget = field()
    qtbot.addWidget(widget)  # never shown: it cannot have the focus
    emitted = []
    widget.edited.connect(emitted.append)
    widget.set_value(old)
    widget.editor.selectAll()
    qtbot.keyClicks(widget.editor, typed)
    widget.set_value(old)
    widget.flush()
    assert emitted == [new]


@pytest.mark.parametrize("lines", [1, 3])
def test_text_is_emitted_when_editing_is_finished(qtbot, lines):
    field = TextField("Notes", lines=lines)
    qtbot.addWidget(field)
    field.set_value("old")
    emitted = []
    field.edited.connect(emitted.append)
    field.editor.selectAll()
    qtbot.keyClicks(field.editor, "steel")
    assert emitted == []
    qtbot.keyClick(field.editor, Qt.Key.Key_Return, Qt.KeyboardModifier.ControlModifier)
    field.flush()
    assert emitted == ["steel"]


def test_beginning_of_a_long_text_is_shown(qtbot):
    field = TextField("Title")
    qtbot.addWidget(field)
    field.set_value("One line on a GMAW pool")
    assert field.editor.cursorPosition() == 0


def test_long_path_shows_both_ends_until_edited(qtbot):
    field = PathField("Folder", tooltip="Where to")
    qtbot.addWidget(field)
    field.resize(240, 40)
    field.show()
    line = field.editor
    assert isinstance(line, PathLine)
    line.clearFocus()
    field.set_value("/data/out")
    assert line.shown() == "/data/out"
    short_path_image = line.grab().toImage()
    path = "/data/" + "very long names of days/" * 6 + "pool-17"
    field.set_value(path)
    shown = line.shown()
    assert "…" in shown
    assert shown.startswith("/data/")
    assert shown.endswith("pool-17")
    assert line.grab().toImage() != short_path_image
    assert field.value() == path
    for text in (line.toolTip(), line.accessibleDescription()):
        assert path in text
        assert "Where to" in text
    # Both paths have the same start and end, so they look the same.
    image = line.grab().toImage()
    field.set_value(path.replace("days/very", "days/VERY", 5))
    assert line.grab().toImage() == image
    line.setFocus()
    qtbot.waitUntil(line.hasFocus)
    assert line.shown() == field.value()
    edited = []
    field.edited.connect(edited.append)
    qtbot.keyClick(line, Qt.Key.Key_End)
    qtbot.keyClicks(line, "b")
    qtbot.keyClick(line, Qt.Key.Key_Return)
    assert len(edited) == 1
    assert edited[0].endswith("pool-17b")
    field.set_value("")
    assert line.toolTip() == "Where to"


def test_choice_is_emitted_as_key_and_kept_with_new_choices(qtbot):
    field = ChoiceField("Scheme", [("fit", "Fit"), ("ers", "Extrapolation")])
    qtbot.addWidget(field)
    emitted = []
    field.edited.connect(emitted.append)
    field.set_value("fit")
    qtbot.keyClick(field.editor, Qt.Key.Key_Down)
    assert emitted == ["ers"]
    field.set_choices([("irs", "Interpolation"), ("ers", "Extrapolation")])
    assert field.value() == "ers"
    assert emitted == ["ers"]


def test_form_aligns_label_editor_and_unit(qtbot):
    form = FieldForm()
    qtbot.addWidget(form)
    fields = [
        NumberField("A", "mm", lowest=0, highest=1, tooltip="first"),
        NumberField("A long label that wraps", "degrees", lowest=0, highest=1, tooltip="second"),
    ]
    form.add(heading("Group"))
    for field in fields:
        form.add(field)
    form.resize(360, 200)
    form.show()
    left, right = (
        [getattr(f.editor.geometry(), side)() for f in fields] for side in "left right".split()
    )
    assert left[0] == left[1]
    assert right[0] == right[1]
    for field in fields:
        assert field.label.buddy() is field.editor
        assert field.editor.accessibleName()
        assert field.editor.toolTip()


def test_table_is_copied_as_text_and_csv(qtbot):
    table = ResultTable("Laser")
    qtbot.addWidget(table)
    table.set_rows([ResultRow("angle", 27.1234, 0.031, "°"), ResultRow("check", "good")])
    assert table.item(0, 1).text() == "27.123"
    assert table.item(0, 1).textAlignment() & Qt.AlignmentFlag.AlignRight
    table.show()
    table.setFocus()
    table.copy_text()
    assert QGuiApplication.clipboard().text() == "angle\t27.123\t0.031\t°\ncheck\tgood\t\t"
    table.copy_csv()
    assert "27.1234,0.031" in QGuiApplication.clipboard().text()
    table.set_rows([ResultRow("angle", 28.0, 0.031, "°")])
    assert table.rowCount() == 1


@pytest.mark.parametrize("points", [9, 14])
def test_names_are_not_cut_in_a_narrow_table(qtbot, points):
    table = ResultTable("Plane")
    qtbot.addWidget(table)
    font = table.font()
    font.setPointSize(points)
    table.setFont(font)
    names = ["Homography off by", "Angle", "Smallest of the two scales along the axes"]
    table.set_rows([ResultRow(name, 12.345, 0.012, "px/mm") for name in names])
    table.show()
    for width, wrapped in ((1200, False), (300, True), (1200, False)):
        table.resize(width, table.height())
        QCoreApplication.processEvents()
        heights = [table.rowHeight(k) for k in range(3)]
        assert all(heights[k] >= table.sizeHintForRow(k) for k in range(3))
        assert (heights[2] > 1.4 * heights[1]) == wrapped
        assert table.viewport().height() >= sum(heights)
