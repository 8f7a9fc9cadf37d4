"""Which number is where: the columns of the splat table and of the gradient table."""

# The splat table [N, COLUMNS] float32. With dy = y - Y and u = x - X - SHEAR·dy, in px:
# log2 alpha = PEAK - FALL_Y·dy² - FALL_X·u², as usual. A sum of squares, accurate for needles too.
X, Y, SHEAR, FALL_Y, FALL_X, PEAK = range(6)
REACH_Y = 6  # px from Y to the last row where alpha reaches 1/255
TIP = 7  # px from Y to the row where the splat reaches furthest right; as far the other way, furthest left
SPREAD = 8  # 1 / FALL_X
OUTLINE = 9  # columns so far: which tiles a splat touches is told by them alone
RED, GREEN, BLUE = 9, 10, 11
# Of a splat that is seen at the centers of pixels, what alpha is made of: GAIN · 2^(that logarithm) - FLOOR. The logarithm is so chosen
# that it ends at 1/255, where the splat ends. As usual they are 1 and 0.
GAIN, FLOOR = 12, 13
GATE = 14  # 1, or 0 of a splat that is culled
# Of a splat that is integrated over pixels (`integrals`), those are of an ellipse around it, and it is itself in
MASS = FALL_X  # opacity · 2π · both standard deviations, px²
OPACITY = FALL_X  # instead, where it is seen through windows
COS, SIN, PER_LONG, PER_SHORT = 12, 13, 14, 15  # the direction of its longer axis, and 1 / standard deviation, 1/px
COLUMNS = 16  # a row is one cache line

# The gradient table [pairs, PULLS] float32, one row per splat and tile. With s = alpha · dLoss/dalpha of a pixel, the sums over the
# tile of s, s·u, s·dy, s·u², s·u·dy and s·dy², then dLoss/dcolor.
SUM, SUM_U, SUM_Y, SUM_UU, SUM_UY, SUM_YY = range(6)
PULL_RED, PULL_GREEN, PULL_BLUE = 6, 7, 8
# Integrated over pixels, the five are s times the derivatives of log alpha by u/long, v/short, log long, log short and the angle.
BY_LONG, BY_SHORT, GROW_LONG, GROW_SHORT, TURN = range(1, 6)
PULLS = 9
