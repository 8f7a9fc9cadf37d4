"""What tests of commands share: brief options, and what a refusal looks like."""


QUICK = ["--views", "given", "--steps", "2"]
NO_STEP = ["--steps", "0"]


def refused(answer, *words):
    """Check that it ended in one sentence on stderr, with nothing on stdout, and return the sentence."""
    code, out, err = answer
    assert (code, out) == (2, "")
    assert err.startswith("mipmap-plugin: ") and err.count("\n") == 1
    assert all(word in err for word in words), err
    return err
