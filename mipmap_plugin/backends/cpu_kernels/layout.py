"""The fields of the splat table and of the gradient table."""

# The splat table [N, SPLAT_FIELDS] float32. With dy = y - Y and u = x - X - SHEAR·dy, in px:
# log2 alpha = PEAK - FALL_Y·dy² - FALL_X·u² for a splat with the usual cut-offs. A sum of squares stays accurate for needles.
X, Y, SHEAR, FALL_Y, PEAK = range(5)
PER_FALL_X = 5  # 1 / FALL_X
RIGHTMOST_DY = 6  # px from Y to the row where the splat reaches furthest right; the row that reaches furthest left is at minus that
REACH_Y = 7  # px from Y to the last row where alpha reaches 1/255
OUTLINE_FIELDS = 8  # the fields so far, half a row, determine which tiles and patches a splat touches
FALL_X = 8
RED, GREEN, BLUE = 9, 10, 11
# For sampling at pixel centers: alpha = GAIN · 2^(that logarithm) - OFFSET. PEAK is chosen so that the logarithm is that of 1/255
# where the splat ends. With the usual cut-offs GAIN is 1 and OFFSET 0.
GAIN, OFFSET = 12, 13
GATE = 14  # 1, or 0 for a culled splat
# For integrals over pixels or windows: the fields above describe a bounding ellipse (`integrals`), and these describe the splat itself.
MASS = FALL_X  # over pixels: opacity · 2π · both standard deviations, px²
OPACITY = FALL_X  # over windows
COS, SIN, PER_LONG, PER_SHORT = 12, 13, 14, 15  # the direction of the longer axis, and 1 / standard deviation along each axis, 1/px
SPLAT_FIELDS = 16

# The gradient table [pairs, GRADS] float32, one row per splat and tile. With s = alpha · dLoss/dalpha of a pixel: the sums over the
# tile of s, s·u, s·dy, s·u², s·u·dy and s·dy², then dLoss/dcolor.
SUM, SUM_U, SUM_Y, SUM_UU, SUM_UY, SUM_YY = range(6)
GRAD_RED, GRAD_GREEN, GRAD_BLUE = 6, 7, 8
# For integrals, instead of the last five sums: the gradients by u/long, v/short, log long, log short and the angle of the longer axis,
# where (u, v) is the offset along both axes, and long and short are the standard deviations.
GRAD_U, GRAD_V, GRAD_LOG_LONG, GRAD_LOG_SHORT, GRAD_ANGLE = range(1, 6)
GRADS = 9

# Sizes (px, px²), opacities and colors beyond this count as infinite: their squares would overflow float32.
HUGE = 1e30
