def pytest_terminal_summary(terminalreporter):
    # Imported late: the type checks cover what is imported after pytest has been configured.
    from drawing_here import WHY_NOT

    if WHY_NOT:
        terminalreporter.write_line(f"TESTS OF IMAGES {WHY_NOT}", red=True)
