/* Poses on which many points agree: a round of samples for each row. What the search is, and its sources, stand in
 * camtorch/calibration/ransac.py. */
#include "consensus.h"

enum { BLOCK = 64, TRIED = 8, STEPS = 3 };

typedef struct {
    const double *points, *measures; /* (3, n), (3, 3, n) */
    int64_t count;
    double most;
} Lines;

/* The squares of points from `first` on, at most BLOCK, at a pose (3, 4) */
static void squares_of(const Lines *lines, const double *pose, int64_t first, int64_t count, double *restrict squares) {
    const double *p = lines->points + first, *m = lines->measures + first;
    const int64_t n = lines->count;
    const double most = lines->most;
    for (int64_t i = 0; i < count; i++) {
        double x = pose[0] * p[i] + pose[1] * p[n + i] + pose[2] * p[2 * n + i] + pose[3];
        double y = pose[4] * p[i] + pose[5] * p[n + i] + pose[6] * p[2 * n + i] + pose[7];
        double z = pose[8] * p[i] + pose[9] * p[n + i] + pose[10] * p[2 * n + i] + pose[11];
        double u = m[i] * x + m[n + i] * y + m[2 * n + i] * z;
        double v = m[3 * n + i] * x + m[4 * n + i] * y + m[5 * n + i] * z;
        double depth = m[6 * n + i] * x + m[7 * n + i] * y + m[8 * n + i] * z;
        double square = (u * u + v * v) / (depth * depth);
        squares[i] = square < most && depth > 0 ? square : most;
    }
}

/* The sum of these squares, and how many points are near; stops if it is more than `enough` */
static double cost_of(const Lines *lines, const double *pose, double enough, int64_t *agree) {
    double squares[BLOCK], cost = 0;
    int64_t near = 0;
    for (int64_t first = 0; first < lines->count && cost < enough; first += BLOCK) {
        int64_t count = lines->count - first < BLOCK ? lines->count - first : BLOCK;
        squares_of(lines, pose, first, count, squares);
        for (int64_t i = 0; i < count; i++) cost += squares[i], near += squares[i] < lines->most;
    }
    if (agree) *agree = near;
    return cost;
}

/* A step of Gauss and Newton by the points near a pose, which stays where it is if there is none */
static void fit(const Lines *lines, double *pose) {
    double normal[6][7] = {{0}}, squares[BLOCK];
    const int64_t n = lines->count;
    for (int64_t i = 0; i < n; i++) {
        if (i % BLOCK == 0) squares_of(lines, pose, i, n - i < BLOCK ? n - i : BLOCK, squares);
        if (!(squares[i % BLOCK] < lines->most)) continue;
        const double *p = lines->points + i, *m = lines->measures + i;
        double turned[3], moved[3], slopes[3][3], seen[3];
        for (int k = 0; k < 3; k++) {
            turned[k] = pose[4 * k] * p[0] + pose[4 * k + 1] * p[n] + pose[4 * k + 2] * p[2 * n];
            moved[k] = turned[k] + pose[4 * k + 3];
        }
        for (int r = 0; r < 3; r++) {
            for (int k = 0; k < 3; k++) slopes[r][k] = m[(3 * r + k) * n];
            seen[r] = dot(slopes[r], moved);
        }
        for (int r = 0; r < 2; r++) {
            double row[7];
            row[6] = seen[r] / seen[2];
            for (int k = 0; k < 3; k++) row[3 + k] = (slopes[r][k] - row[6] * slopes[2][k]) / seen[2];
            cross(turned, row + 3, row);
            for (int a = 0; a < 6; a++)
                for (int b = a; b < 7; b++) normal[a][b] += row[a] * row[b];
        }
    }
    double step[6];
    for (int a = 0; a < 6; a++) normal[a][a] = normal[a][a] * (1 + 1e-9) + 1e-300, step[a] = -normal[a][6];
    if (!triangle(6, 7, normal[0])) return;
    solved(6, 7, normal[0], step);
    turn(step, pose, 4);
    for (int k = 0; k < 3; k++) pose[4 * k + 3] += step[3 + k];
}

static void adjugate(const double *a, double *found) {
    for (int i = 0; i < 3; i++) cross(a + 3 * ((i + 1) % 3), a + 3 * ((i + 2) % 3), found + 3 * i);
}

/* The two vectors whose product a symmetric matrix of rank two is, or none: J. Richter-Gebert, Perspectives on Projective
   Geometry, 2011, section 11.1 */
static int split(const double *conic, double *first, double *second) {
    double square[9], product[9];
    int most = 0, place = 0;
    adjugate(conic, square);
    for (int i = 1; i < 3; i++)
        if (-square[4 * i] > -square[4 * most]) most = i;
    if (!(-square[4 * most] > 0)) return 0;
    double root = -1 / sqrt(-square[4 * most]);
    double x = square[3 * most] * root, y = square[3 * most + 1] * root, z = square[3 * most + 2] * root;
    const double skew[9] = {0, -z, y, z, 0, -x, -y, x, 0};
    for (int i = 0; i < 9; i++) {
        product[i] = conic[i] + skew[i];
        if (fabs(product[i]) > fabs(product[place])) place = i;
    }
    for (int i = 0; i < 3; i++) first[i] = product[3 * (place / 3) + i], second[i] = product[3 * i + place % 3];
    return 1;
}

/* A real root of a + b x + c x^2 + d x^3, the one furthest from the others where there are three */
static double root_of(double a, double b, double c, double d) {
    a /= d, b /= d, c /= 3 * d;
    double q = c * c - b / 3, r = c * (c * c - b / 2) + a / 2, excess = r * r - q * q * q, x;
    if (excess > 0) {
        double large = cbrt(fabs(r) + sqrt(excess));
        x = large + q / large;
    } else {
        double three = 2 * sqrt(q > 0 ? q : 0), cosine = 2 * fabs(r) / (three * q);
        x = three * cos(acos(cosine < 1 ? cosine : 1) / 3);
    }
    x = (r < 0 ? x : -x) - c;
    for (int i = 0; i < 2; i++) x -= (((x + 3 * c) * x + b) * x + a) / ((3 * x + 6 * c) * x + b);
    return x;
}

/* Columns: along a side of a triangle, and across its plane */
static void frame(double corners[3][3], double *found) {
    double one[3], two[3], axes[3][3];
    for (int k = 0; k < 3; k++) one[k] = corners[1][k] - corners[0][k], two[k] = corners[2][k] - corners[1][k];
    cross(one, two, axes[2]);
    double length = sqrt(dot(one, one)), across = sqrt(dot(axes[2], axes[2]));
    for (int k = 0; k < 3; k++) axes[0][k] = one[k] / length, axes[2][k] /= across;
    cross(axes[2], axes[0], axes[1]);
    for (int k = 0; k < 3; k++)
        for (int j = 0; j < 3; j++) found[3 * k + j] = axes[j][k];
}

/* How many poses (3, 4) there are, at most four, in which a triangle's corners are on rays.

   The ratios of the corners' distances are where two conics meet: on the two lines that one of their pencil falls into,
   whose place there is a root of a cubic (M. Persson and K. Nordberg, Lambda Twist, ECCV 2018; Y. Ding et al., Revisiting
   the P3P Problem, CVPR 2023). In differences of the distances instead of the distances, nothing cancels where the view
   is narrow: the squared sides (0, 1), (1, 2) and (2, 0) of a triangle with corners s_i along rays r_i are, with
   e = |r_i - r_j|^2, (s_i - s_j)^2 + e s_i s_j, which are quadratic forms of p = s_0 - s_2, q = s_1 - s_2 and w = s_2:
   `constant` of the first term, `one` of the second what there is of p w and q w, beside w^2. */
int THIS(poses_of_three)(double points[3][3], double rays[3][3], double poses[4][12]) {
    static const double one[3][9] = {
        {0, 0, .5, 0, 0, .5, .5, .5, 0}, {0, 0, 0, 0, 0, .5, 0, .5, 0}, {0, 0, .5, 0, 0, 0, .5, 0, 0}};
    static const double constant[3][9] = {{1, -1, 0, -1, 1, 0, 0, 0, 0}, {0, 0, 0, 0, 1, 0, 0, 0, 0}, {1}};
    double apart[3], sides[3], widest = 0, longest = 0, forms[3][9], all[9], conics[2][9], adjugates[2][9];
    for (int i = 0; i < 3; i++) {
        apart[i] = sides[i] = 0;
        for (int k = 0; k < 3; k++) {
            double ray = rays[i][k] - rays[(i + 1) % 3][k], side = points[i][k] - points[(i + 1) % 3][k];
            apart[i] += ray * ray, sides[i] += side * side;
        }
        widest = apart[i] > widest ? apart[i] : widest;
        longest = sides[i] > longest ? sides[i] : longest;
    }
    double width = sqrt(widest);
    for (int i = 0; i < 3; i++) {
        sides[i] /= longest;
        for (int k = 0; k < 9; k++) forms[i][k] = constant[i][k] + apart[i] / widest * (width * one[i][k] + (k == 8));
    }
    forms[0][1] += apart[0] / 2, forms[0][3] += apart[0] / 2;
    for (int k = 0; k < 9; k++) {
        conics[0][k] = forms[0][k] * sides[1] - forms[1][k] * sides[0];
        conics[1][k] = forms[2][k] * sides[1] - forms[1][k] * sides[2];
        all[k] = forms[0][k] + forms[1][k] + forms[2][k];
    }
    double products[2][2] = {{0}};
    for (int i = 0; i < 2; i++) {
        adjugate(conics[i], adjugates[i]);
        for (int j = 0; j < 2; j++)
            for (int k = 0; k < 9; k++) products[i][j] += adjugates[i][k] * conics[j][k];
    }
    int less = fabs(products[0][0]) > fabs(products[1][1]), more = !less; /* `less` is the one without a factor */
    double root = root_of(products[less][less] / 3, products[less][more], products[more][less], products[more][more] / 3);
    double pencil[9], other[9], lines[2][3];
    for (int k = 0; k < 9; k++) {
        pencil[k] = conics[less][k] + root * conics[more][k];
        other[k] = root * conics[less][k] - conics[more][k];
    }
    if (!split(pencil, lines[0], lines[1])) return 0;
    double corners[3][3], of_points[9], of_corners[9], total = sides[0] + sides[1] + sides[2];
    int found = 0;
    frame(points, of_points);
    for (int line = 0; line < 2; line++) {
        const double *l = lines[line];
        const double skew[9] = {0, -l[2], l[1], l[2], 0, -l[0], -l[1], l[0], 0};
        double half[9], dual[9], meets[2][3];
        multiplied(other, skew, half);
        for (int i = 0; i < 3; i++)
            for (int j = 0; j < 3; j++)
                dual[3 * i + j] = skew[i] * half[j] + skew[3 + i] * half[3 + j] + skew[6 + i] * half[6 + j];
        if (!split(dual, meets[0], meets[1])) continue;
        for (int which = 0; which < 2; which++) {
            const double *z = meets[which];
            double whole = 0, distances[3];
            for (int i = 0; i < 3; i++) whole += z[i] * dot(all + 3 * i, z);
            double scale = sqrt(total / whole * longest) * (z[2] < 0 ? -1 : 1);
            distances[2] = z[2] / width * scale;
            distances[0] = z[0] * scale + distances[2], distances[1] = z[1] * scale + distances[2];
            if (!(distances[0] > 0 && distances[1] > 0 && distances[2] > 0)) continue;
            for (int i = 0; i < 3; i++)
                for (int k = 0; k < 3; k++) corners[i][k] = distances[i] * rays[i][k];
            frame(corners, of_corners);
            double *pose = poses[found++];
            for (int i = 0; i < 3; i++) {
                pose[4 * i + 3] = (corners[0][i] + corners[1][i] + corners[2][i]) / 3;
                for (int j = 0; j < 3; j++) {
                    pose[4 * i + j] = dot(of_corners + 3 * i, of_points + 3 * j);
                    pose[4 * i + 3] -= pose[4 * i + j] * (points[0][j] + points[1][j] + points[2][j]) / 3;
                }
            }
        }
    }
    return found;
}

static void round_of(const Agreement *given, int64_t place) {
    const int64_t n = given->count, row = given->rows[place], seen = given->counts[row];
    const int64_t *order = given->order + row * n;
    Lines lines = {given->points + row * 3 * n, given->measures + row * 9 * n, n, given->most};
    double tried[TRIED + 1][12], costs[TRIED];
    for (int i = 0; i < TRIED; i++) costs[i] = INFINITY;
    memset(tried, 0, sizeof tried);
    for (int64_t sample = 0; sample < given->samples; sample++) {
        const double *numbers = given->numbers + 3 * sample;
        int64_t i = (int64_t)(numbers[0] * seen), j = (int64_t)(numbers[1] * (seen - 1));
        int64_t k = (int64_t)(numbers[2] * (seen - 2));
        j += j >= i;
        int64_t low = i < j ? i : j, high = i < j ? j : i;
        k += k >= low;
        k += k >= high;
        const int64_t three[3] = {order[i], order[j], order[k]};
        double points[3][3], rays[3][3], poses[4][12];
        for (int corner = 0; corner < 3; corner++)
            for (int axis = 0; axis < 3; axis++) {
                points[corner][axis] = lines.points[axis * n + three[corner]];
                rays[corner][axis] = lines.measures[(6 + axis) * n + three[corner]];
            }
        for (int found = THIS(poses_of_three)(points, rays, poses); found-- > 0;) {
            double cost = cost_of(&lines, poses[found], costs[TRIED - 1], NULL);
            if (!(cost < costs[TRIED - 1])) continue;
            int at = TRIED - 1;
            for (; at > 0 && costs[at - 1] > cost; at--) {
                costs[at] = costs[at - 1];
                memcpy(tried[at], tried[at - 1], sizeof tried[at]);
            }
            costs[at] = cost;
            memcpy(tried[at], poses[found], sizeof tried[at]);
        }
    }
    double *best = given->best + 12 * row;
    memcpy(tried[TRIED], best, sizeof tried[TRIED]);
    for (int i = 0; i <= TRIED; i++) {
        int64_t agree;
        for (int step = 0; step < STEPS; step++) fit(&lines, tried[i]);
        double cost = cost_of(&lines, tried[i], INFINITY, &agree);
        if (!(cost < given->costs[row])) continue;
        given->costs[row] = cost, given->agree[row] = agree;
        memcpy(best, tried[i], sizeof tried[i]);
    }
}

/* Takes rows, of those that no thread has taken, until none is left */
void THIS(consensus)(const Agreement *given) {
    for (;;) {
        int64_t place = __atomic_fetch_add(given->next, 1, __ATOMIC_RELAXED);
        if (place >= given->row_count) return;
        round_of(given, place);
    }
}
