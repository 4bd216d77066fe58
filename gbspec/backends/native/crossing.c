/* What is kept of a sub-step that events cut. Only kernels of models with events have it; they compute one trajectory at
   a time (TILE is 1), since each is cut at times of its own. */

#define CASCADE 100 /* most events at one time */
#define CLOSE 100   /* most times of events in one sub-step */
#define TICK 1e3    /* rates are differences over at least so many bands, in steps of which nothing else would be seen */
#define SHORT 20    /* most of them that follow each other within the band */
#define FALLING 6   /* so many ever shorter intervals, the last one less than NEAR bands, have no end */
#define NEAR 1e5
#define GUARDS (EVENTS - TIMED_EVENTS)
#define FIRST_SWITCH (EVENTS - 2 * SWITCHES) /* the last events are switches of right-hand sides, two for each */

/* A part of a sub-step between two times of events. */
typedef struct {
    double at, size;
    double turn;      /* the number of the timed event that ends it */
    int which;        /* the event whose time ends it; -1: the end of the sub-step */
    int first, count; /* the events at its start, a part of `fired` */
    real side[SWITCHES + 1]; /* on which right-hand sides are held in it */
    real x[STATES], reached[STATES]; /* after those events, and at its end before the next ones */
} Piece;

typedef struct {
    double begin, length, unit, tick, origin, band;
    double first[INPUTS + 1], last[INPUTS + 1], before[INPUTS + 1]; /* inputs, which are linear in time */
    real entry[STATES]; /* after what arrives at the start, before events */
    double timing[TIMED_EVENTS + 1][3], turn[TIMED_EVENTS + 1];
    int on[GUARDS + 1], pending[EVENTS], known;
    real guard[GUARDS + 1], rate[GUARDS + 1]; /* where `known`: at the start of the current part */
    int count, fired_count, endless; /* endless: events follow each other without end, and there is no solution */
    int turns, uncut, slid, suspended[SWITCHES + 1], released[SWITCHES + 1]; /* of switches: see switches.c */
    int16_t fired[(CLOSE + 2) * CASCADE];
    Piece pieces[CLOSE + 2];
    real chain[(CASCADE + 1) * STATES];
} Crossing;
